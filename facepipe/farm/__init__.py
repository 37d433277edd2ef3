"""The same work on many faces: plans, their tasks, and the processes that do them, here or on a cluster."""
