"""Operations of clients, one module for each kind."""
