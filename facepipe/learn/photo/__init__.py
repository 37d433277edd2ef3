"""A face from photos: sliders, expression, camera and light that show what the photos show."""
