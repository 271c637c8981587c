"""What is read from and written to disk: users' files, the cache folder, results, plots."""
