"""The identification stack of the thesis: features, database, LSI, FSF, CME, RSI and its simulator."""
