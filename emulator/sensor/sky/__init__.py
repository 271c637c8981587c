"""The sky besides the catalogue stars: Sun, Moon, Earth, planets, obstructions and false stars."""
