"""How a command is spoken to: flags, their values, the names that data may use, and messages."""
