"""A page in the browser that shows and steers a light field: its pictures and its small server."""
