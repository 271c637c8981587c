"""Star detection: background, matched filter, centroids, trails; reading and writing of image files."""
