"""The colours of Okabe and Ito, which colour-blind readers can tell apart too."""

BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
INK, FAINT = "#333333", "#9A9A9A"
BODY_COLOURS = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)


def body_colour(index: int) -> str:
    """The colour of the body of that index."""
    return BODY_COLOURS[index % len(BODY_COLOURS)]
