"""What all rooms share: errors, names, files, locks, trust, threads, reports."""

__version__ = "0.1.0"
