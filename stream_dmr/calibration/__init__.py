"""The camera's lens and the reference plane, from pictures of a chessboard."""
