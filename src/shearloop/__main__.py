"""`python -m shearloop` is `shearloop`."""

import sys

from shearloop.cli import main

sys.exit(main())
