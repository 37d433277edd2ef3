"""What may be read, written, reached and started: the one policy that paths, URLs and child processes pass."""
