"""The application's core: scenes, cameras and pictures of the commands, by options as data."""
