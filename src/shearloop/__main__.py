"""`python -m shearloop` is `shearloop`."""

import sys

from shearloop.daemon.cli import main

sys.exit(main())
