"""``python -m rl2grid`` is ``rl2grid``."""

import sys

from rl2grid.cli.main import main

sys.exit(main())
