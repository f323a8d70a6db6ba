"""Features around the core that reach it through the registries; the core never imports them."""
