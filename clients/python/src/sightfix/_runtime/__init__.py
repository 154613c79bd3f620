"""The differences of the asynchronous and the synchronous client; the rest of them is one code."""
