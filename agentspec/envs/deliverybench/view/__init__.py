"""What an agent sees: the state as data (`cards`), as text (`observation`), as a menu, and as a picture (`render`)."""
