"""The live server, its protocol, its page and its Python clients."""
