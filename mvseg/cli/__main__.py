"""`python -m mvseg.cli <verb>`."""

import sys

from mvseg.cli import main

sys.exit(main())
