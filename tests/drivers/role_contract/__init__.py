"""The contract that every installed driver passes."""
