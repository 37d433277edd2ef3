"""What hosts of faces call: faces on their stages, edits read back, live blends, deliveries."""
