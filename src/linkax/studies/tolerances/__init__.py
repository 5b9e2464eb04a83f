"""Outputs that deviate where parameters do."""
