"""Where motion starts: states that users give or ask for, checked and put on the closed loops."""
