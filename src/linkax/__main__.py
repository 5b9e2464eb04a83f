"""`python -m linkax` does what the command `linkax` does."""

import sys

from linkax_command import main

sys.exit(main())
