"""Processes that do lines of the command line for others, here or on a cluster, with what they read and wrote."""
