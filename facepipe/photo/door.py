"""What others find of photo fits by name."""

NAME = "photos"
FORMER = {
    "facepipe.learn.features": ("facepipe.photo.features",),
    "facepipe.learn.photo": ("facepipe.photo.descent",),
    "facepipe.learn.photo.amortised": ("facepipe.photo.amortised",),
    "facepipe.photo_options": ("facepipe.photo.options",),
    "facepipe.processors.photo_fit": ("facepipe.photo.fit", "facepipe.networks.files"),
    "facepipe.processors.photo_texture": ("facepipe.photo.texture",),
}
