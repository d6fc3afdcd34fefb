"""One file to send: a page that draws a scene for a panel, or for any screen, in the browser of whoever opens it."""
