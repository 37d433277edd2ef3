"""What all rooms share: errors, names, files, locks, trust, threads, reports."""
