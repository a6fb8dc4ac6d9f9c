"""How much of the attainable savings estimates could bring, and which costs what (``python -m eval.limit``)."""
