"""What every protocol shares: plans that are stored, states, the answers that any page may get, and
replay. Pure: no store, no web, no configuration, and no protocol by name."""
