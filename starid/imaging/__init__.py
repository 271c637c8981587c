"""From an image to stars: background, matched filter, centroids, trails, and image files."""
