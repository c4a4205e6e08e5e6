"""`python -m mvseg.cli <verb>`."""

import sys

from mvseg.cli.command import main

sys.exit(main())
