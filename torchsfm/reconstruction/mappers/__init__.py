"""From pairs of images to models: one by one, all at once, in windows, without any camera; and models put right."""
