"""The Hipparcos stars as an observer in motion sees them."""

from starid.catalog.catalog import DEFAULT_EPOCH, Band, StarCatalog, load_catalog

__all__ = ["DEFAULT_EPOCH", "Band", "StarCatalog", "load_catalog"]
