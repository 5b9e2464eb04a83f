"""Joint types, one file each: how a joint moves in the tree, and its constraint rows where it is cut."""
