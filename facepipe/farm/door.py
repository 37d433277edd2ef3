"""What the wing of batches gives the public API and the command line, found by name."""

NAME = "batches"
FUNCTIONS = {"batch": "facepipe.farm.batch:batch"}
COMMANDS = {
    "batch": {
        "module": "facepipe.farm.batch_command",
        "summary": "run the same steps over many faces, here or on a cluster",
    }
}
