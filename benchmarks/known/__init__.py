"""Tasks whose posterior is known, and how far samples are from it."""
