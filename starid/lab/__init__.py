"""The laboratory: the experiments of the thesis, published algorithms, and their comparison with other programs."""
