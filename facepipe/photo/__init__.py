"""A face from photos: sliders, expression, camera and light that show what they show, and textures made of them."""
