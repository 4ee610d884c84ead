-- ================================================================================================
-- rosbayes: bm1_table
-- Read-only memory with the contents of a MIF. The data appear one clock after their address.
-- MIT licence; datasheet: docs/hardware/bm1_table.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;

-- The architecture is in the file that is compiled with this one:
-- simulation/bm1_table_textio.vhd or synthesis/bm1_table_block.vhd.

entity bm1_table is
  generic (
    FILE_NAME    : string;   -- path of the MIF
    WORD_BITS    : positive; -- width of the MIF's words
    DEPTH        : positive; -- number of words
    ADDRESS_BITS : positive; -- width of the address
    FIRST_BIT    : natural;  -- position of the lowest bit that is read from a word
    DATA_BITS    : positive  -- number of bits that are read from a word
  );
  port (
    clk_i     : in    std_logic;                                   -- clock
    enable_i  : in    std_logic;                                   -- 1: read, 0: keep the output
    address_i : in    std_logic_vector(ADDRESS_BITS - 1 downto 0); -- must be less than DEPTH
    data_o    : out   std_logic_vector(DATA_BITS - 1 downto 0)     -- bits that are read, one clock after their address
  );
end entity bm1_table;
