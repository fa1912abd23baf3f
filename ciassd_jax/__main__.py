"""`python -m ciassd_jax` is the program `ciassd`."""

import sys

from ciassd_jax.cli import main

sys.exit(main())
