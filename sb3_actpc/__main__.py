"""``python -m sb3_actpc``: the command ``sb3-actpc``."""

import sys

from sb3_actpc.cli import main

sys.exit(main())
