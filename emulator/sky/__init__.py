"""The sky around the stars of the catalogue: Sun, Moon, Earth, planets, obstructions and false stars."""
