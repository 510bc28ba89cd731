"""``python -m rl2grid.cli`` is ``rl2grid``."""

import sys

from rl2grid.cli.main import main

sys.exit(main())
