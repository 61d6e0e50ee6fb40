"""``python -m gpebo_cli`` is ``gpebo``."""

from __future__ import annotations

from gpebo_cli.cli.start import entry

if __name__ == "__main__":
    entry()
