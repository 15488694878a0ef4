"""`python -m dyngrasp`, the same as `dyngrasp`."""

import sys

from dyngrasp.cli import main

sys.exit(main())
