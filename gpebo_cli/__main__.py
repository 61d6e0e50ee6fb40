"""``python -m gpebo_cli`` is ``gpebo``."""

from __future__ import annotations

import sys

from gpebo_cli.cli.app import main

if __name__ == "__main__":
    sys.exit(main())
