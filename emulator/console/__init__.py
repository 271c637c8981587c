"""The console: a web page that shows a running emulator and speaks to it as one more OBC."""
