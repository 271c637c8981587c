"""The geometric identifier: verified triangles of bright stars, and tracking near a prediction."""
