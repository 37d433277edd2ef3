"""Pictures of fits: a face in a photo's light, and what reports show."""
