"""Operations of clients, with one module for each kind."""
