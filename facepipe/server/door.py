"""What the wing of the server gives the command line, found by name."""

NAME = "server"
COMMANDS = {
    "serve": {
        "module": "facepipe.server.serve_command",
        "summary": "keep faces and work on them for browsers and devices",
    }
}
