"""Which stars these are, and the attitude that follows."""
