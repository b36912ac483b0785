"""Programs that run inside the virtual environments of other packages and are spoken to through their pipes.

They import neither this package nor what it needs: only the standard library, numpy, the package that they serve, and their
neighbour ``frames.py``. Each has a class ``Server`` with a method for every question, given its values and arrays:

- ``build``: ``method``, ``n_observations``, ``n_actions``, ``batch_size``, ``seed``, and ``method_kwargs``, the package's own;
- ``show``: ``observations``, ``actions``, ``next_observations``, ``rewards`` and ``terminations`` of N
  transitions;
- ``train``: answers the losses of one update of every part;
- ``predict``: ``observations`` (n, obs_dim); answers ``actions`` (n, A);
- ``save``: answers ``parameters``, all of them as bytes; ``load`` takes them back.
"""
