"""Feature extractors: networks that tell how alike two pictures of a face are, with gradients to the pixels."""
