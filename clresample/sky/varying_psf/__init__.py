"""PSFs that vary over an image: their interface, and their bases of few PSFs."""
