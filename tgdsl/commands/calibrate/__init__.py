"""`tgdsl calibrate`: parameters of sensors from recordings, and of a real hand from logs."""
