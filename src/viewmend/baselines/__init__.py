"""Published video inpainters, written from the facts of their papers, that load their authors' weights."""
