"""Many inputs, one after the other and side by side: what is to do, what was done, and the processes that do it."""
