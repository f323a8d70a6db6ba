"""Published video inpainting networks, implemented from their papers; they load the authors' weights."""
