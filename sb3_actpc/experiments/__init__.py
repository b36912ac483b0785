"""Whole training runs, comparisons of many, and reports about them."""
