"""`python -m agentspec.cli`."""

import sys

from agentspec.cli import main

if __name__ == "__main__":
    sys.exit(main())
