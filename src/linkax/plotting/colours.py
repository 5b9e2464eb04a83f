"""Okabe and Ito's colours, told apart by colour-blind readers too."""

BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
INK, FAINT = "#333333", "#9A9A9A"
