"""Dimensions of linkages for what they are to do."""
