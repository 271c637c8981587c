"""The experiments of the thesis, reproduced with the real catalogue."""
