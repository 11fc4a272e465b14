"""`python -m daemon` is `shearloop`."""

import sys

from daemon.cli import main

sys.exit(main())
