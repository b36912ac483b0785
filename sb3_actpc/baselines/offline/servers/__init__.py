"""Programs that run inside the virtual environments of other packages and are spoken to through their pipes.

They import neither this package nor what it needs: only the standard library, numpy, the package that they serve, and their
neighbour ``frames.py``.
"""
