"""Programs that run inside the virtual environments of other packages and are spoken to through their pipes.

They import neither this package nor what it needs: only the standard library, numpy, the package that they serve, and their
neighbour ``frames.py``. Each has a class ``Server`` with a method for every question, given its values and arrays:

- ``build``: ``method``, ``n_observations``, ``n_actions``, ``batch_size``, ``seed``, and ``method_kwargs``, the package's own;
- ``show``: ``observations``, ``actions``, ``next_observations``, ``rewards``, ``terminations`` and ``last_rows`` (the index of
  the last transition of each one's episode) of N transitions;
- ``train``: answers the losses of one update of every part;
- ``predict``: ``observations`` (n, obs_dim), ``episode_starts`` (n,), true where one begins, and after the first step the
  state, arrays whose names begin with ``state_``; answers ``actions`` (n, A) and the next state;
- ``save``: answers ``parameters``, all of them as bytes; ``load`` takes them back.
"""
