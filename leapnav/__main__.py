"""`python -m leapnav` is the command `leapnav`."""

import sys

from leapnav.cli import main

sys.exit(main())
