"""Colours and text sizes that all figures share."""

from typing import Final

FEW_COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
INK, GREY, FAINT = "#222222", "#8a8a8a", "#dddddd"
SMALL, PLAIN, LARGE = 10.0, 11.5, 15.0
