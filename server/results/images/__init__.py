"""Evaluation of images: their quality and texture, previews, the specimen, a region projected into them."""
