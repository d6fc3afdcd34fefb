"""A page in the browser that shows and steers a light field: what it draws, and the small server that it comes from."""
