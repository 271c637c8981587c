"""The geometric star identifier: verified triangles of bright stars, and tracking near a prediction."""
