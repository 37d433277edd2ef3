"""Short videos of one person: the frames that a photo fit learns most from."""
