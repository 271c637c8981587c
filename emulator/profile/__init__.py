"""The device profile: its tables, and what is built from them."""

from starhil.emulator.profile.profile import DEFAULT_PROFILE, Profile, camera_of, load_profile

__all__ = ["DEFAULT_PROFILE", "Profile", "camera_of", "load_profile"]
