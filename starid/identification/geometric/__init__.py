"""The geometric star identifier: search by triangles of bright stars, verification, and tracking."""
