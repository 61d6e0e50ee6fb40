"""The version, alone: whoever needs it need not import the Python interface."""

__version__ = "0.1.0"
