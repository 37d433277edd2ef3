"""Feature extractors: networks that measure how alike two pictures of a face are, with gradients to the pixels."""
