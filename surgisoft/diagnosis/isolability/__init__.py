"""Which effects a recording's design can tell apart."""
