"""Machines from USD Physics: rigid bodies, joints and drives of a stage, by Pixar's own library.

What the schemas mean: https://openusd.org/release/api/usd_physics_page_front.html.
"""
