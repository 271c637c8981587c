"""The identification algorithms of the thesis: features, database, LSI, FSF, CME and RSI; its simulator."""
