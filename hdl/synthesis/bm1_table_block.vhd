-- ================================================================================================
-- rosbayes: bm1_table, architecture for Quartus
-- A memory block that Quartus fills from the MIF. Not yet opened by Quartus.
-- MIT licence; datasheet: docs/hardware/bm1_table.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

architecture block_memory of bm1_table is

  type memory_t is array (0 to DEPTH - 1) of std_logic_vector(WORD_BITS - 1 downto 0);

  signal memory : memory_t;
  signal word   : std_logic_vector(WORD_BITS - 1 downto 0);

  -- Bits of a word that are never read are removed by the synthesis.
  attribute ram_init_file : string;
  attribute ram_init_file of memory : signal is FILE_NAME;

begin

  read_memory : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (enable_i = '1') then
        word <= memory(to_integer(unsigned(address_i)));
      end if;
    end if;

  end process read_memory;

  data_o <= word(FIRST_BIT + DATA_BITS - 1 downto FIRST_BIT);

end architecture block_memory;
