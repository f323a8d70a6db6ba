"""Walking around the subject while it happens: render service, server, protocol, and the page."""
