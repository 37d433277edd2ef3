"""What the wing of batches gives the public API, found by name."""

NAME = "batches"
FUNCTIONS = {"batch": "facepipe.farm.batch:batch"}
