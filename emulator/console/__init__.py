"""The console: a web page that shows a running emulator and talks to it as another OBC."""
