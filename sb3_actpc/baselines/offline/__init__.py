"""Offline methods of other packages, trained in virtual environments of their own."""
