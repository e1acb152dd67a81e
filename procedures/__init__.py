"""What a person does at the bench: one module a kind of experiment."""
