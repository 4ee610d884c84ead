-- ================================================================================================
-- rosbayes: bm1_utilities
-- Functions on sizes and widths that several units of the BM1 share.
-- MIT licence; datasheet: docs/hardware/README.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;

library work;
  use work.bm1_parameters.all;

package bm1_utilities is

  -- Bits of a slot in a vector of inputs: the widest address or code.
  constant SLOT_BITS : positive := 16;

  -- Return the number of bits for 0 to COUNT - 1, at least 1.

  function bits_for (
    count : positive
  ) return positive;

  -- Return the number of cells of a column that have an input of their own.

  function inputs_per_column (
    mode  : sensor_mode_t;
    lines : positive
  ) return positive;

  -- Return 1 for true and 0 for false.

  function to_natural (
    condition : boolean
  ) return natural;

  -- Return '1' for true and '0' for false.

  function to_std_logic (
    condition : boolean
  ) return std_logic;

  -- Return a decimal number with leading zeros, as wide as the digits of HIGHEST.

  function padded (
    number  : natural;
    highest : natural
  ) return string;

  -- A memory (bm1_table.vhd), as a component: the compiled file provides its architecture, and a synthesis that
  -- counts logic leaves it out.

  component bm1_table is
    generic (
      FILE_NAME    : string;
      WORD_BITS    : positive;
      DEPTH        : positive;
      ADDRESS_BITS : positive;
      FIRST_BIT    : natural;
      DATA_BITS    : positive
    );
    port (
      clk_i     : in    std_logic;
      enable_i  : in    std_logic;
      address_i : in    std_logic_vector(ADDRESS_BITS - 1 downto 0);
      data_o    : out   std_logic_vector(DATA_BITS - 1 downto 0)
    );
  end component bm1_table;

end package bm1_utilities;

package body bm1_utilities is

  function bits_for (
    count : positive
  ) return positive is

    variable bits : positive := 1;

  begin

    while 2 ** bits < count loop

      bits := bits + 1;

    end loop;

    return bits;

  end function bits_for;

  function inputs_per_column (
    mode  : sensor_mode_t;
    lines : positive
  ) return positive is
  begin

    if (mode = SENSOR_COLUMN) then
      return 1;
    end if;

    return lines;

  end function inputs_per_column;

  function to_natural (
    condition : boolean
  ) return natural is
  begin

    if (condition) then
      return 1;
    end if;

    return 0;

  end function to_natural;

  function to_std_logic (
    condition : boolean
  ) return std_logic is
  begin

    if (condition) then
      return '1';
    end if;

    return '0';

  end function to_std_logic;

  function padded (
    number  : natural;
    highest : natural
  ) return string is

    constant DIGITS : string                                     := integer'image(number);
    constant WIDEST : string                                     := integer'image(highest);
    constant ZEROS  : string(1 to WIDEST'length - DIGITS'length) := (others => '0');

  begin

    return ZEROS & DIGITS;

  end function padded;

end package body bm1_utilities;
