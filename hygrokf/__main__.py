"""`python -m hygrokf`: the command line without its installed script."""

import sys

from hygrokf.commands.main import main

if __name__ == "__main__":
    sys.exit(main())
