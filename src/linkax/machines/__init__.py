"""Machines from files, as data that can be looked at and changed."""
