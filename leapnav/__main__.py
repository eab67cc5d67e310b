"""The command line as `python -m leapnav`."""

import sys

from leapnav.cli import main

sys.exit(main())
