"""A face from scans: scans of photos, landmarks on them, an actor's neutral and shapes, and databases of such faces."""
