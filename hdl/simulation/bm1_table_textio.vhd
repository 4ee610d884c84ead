-- ================================================================================================
-- rosbayes: bm1_table, architecture for simulators
-- Reads the MIF when the design is elaborated.
-- MIT licence; datasheet: docs/hardware/bm1_table.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

library std;
  use std.textio.all;

architecture textio of bm1_table is

  type memory_t is array (0 to DEPTH - 1) of std_logic_vector(DATA_BITS - 1 downto 0);

  -- Return the memory's contents. The MIF must be in the toolchain's canonical form: hexadecimal, one entry a line.

  impure function contents return memory_t is

    file     source : text open read_mode is FILE_NAME;
    variable row    : line;
    variable digit  : character;
    variable found  : memory_t := (others => (others => '0'));
    variable word   : std_logic_vector(4 * ((WORD_BITS + 3) / 4) - 1 downto 0);
    variable inside : boolean  := false;
    variable place  : natural;
    variable good   : boolean;

  begin

    while not endfile(source) loop

      readline(source, row);
      next when row'length = 0;

      if (not inside) then
        inside := row'length >= 7 and row.all(1 to 7) = "CONTENT";
        next;
      end if;

      exit when row.all = "END;";
      place := 0;

      loop

        read(row, digit);
        exit when digit = ' ';

        if (digit >= 'A') then
          place := 16 * place + character'pos(digit) - character'pos('A') + 10;
        else
          place := 16 * place + character'pos(digit) - character'pos('0');
        end if;

      end loop;

      read(row, digit);
      hread(row, word, good);
      assert good and place < DEPTH
        report FILE_NAME & " is not a MIF of " & integer'image(DEPTH) & " words of "
               & integer'image(WORD_BITS) & " bits in canonical form"
        severity failure;
      found(place) := word(FIRST_BIT + DATA_BITS - 1 downto FIRST_BIT);

    end loop;

    return found;

  end function contents;

  -- a constant: as a signal it would slow simulators down
  constant MEMORY : memory_t := contents;

  signal data : std_logic_vector(DATA_BITS - 1 downto 0) := (others => '0');

begin

  read_memory : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (enable_i = '1') then
        data <= MEMORY(to_integer(unsigned(address_i)));
      end if;
    end if;

  end process read_memory;

  data_o <= data;

end architecture textio;
