"""Methods side by side on the same images, pairs, cameras and mapping options."""
