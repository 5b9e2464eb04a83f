"""Joint types, one file each: their motion in the tree, and their constraint rows when cut."""
