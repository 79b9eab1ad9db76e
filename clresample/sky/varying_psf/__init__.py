"""PSFs that vary over an image: what each answers, and the few PSFs that stand for many."""
