"""A window of the program's own over the whole of a screen, by GLFW and OpenGL."""
