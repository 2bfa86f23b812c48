"""The pages: a live map in the browser, and what it reads."""
