"""Parameters of a study: numbers in pytrees, free ones, and how sure they are."""
