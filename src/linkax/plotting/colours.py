"""The colours of Okabe and Ito, which colour-blind readers can tell apart too."""

BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
INK, FAINT = "#333333", "#9A9A9A"
