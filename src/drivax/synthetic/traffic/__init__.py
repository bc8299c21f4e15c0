"""Everything that moves on the roads, and the roles that it is given."""
