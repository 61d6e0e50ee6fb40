"""The Python interface: what ``from gpebo_cli import run`` finds.

The same as the command line, without Hydra and without files: ``choice`` finds the configuration,
in the same files, ``calls`` runs it, ``result`` is what comes back.
"""
