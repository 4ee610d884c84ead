-- ================================================================================================
-- rosbayes: bm1_counter
-- Counts the ones of a line's bitstream and reports when the target count is reached.
-- MIT licence; datasheet: docs/hardware/bm1_counter.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

entity bm1_counter is
  generic (
    COUNTER_BITS : positive -- width of the counter
  );
  port (
    clk_i    : in    std_logic;                                   -- clock
    clear_i  : in    std_logic;                                   -- clear the counter
    enable_i : in    std_logic;                                   -- the machine runs a cycle
    bit_i    : in    std_logic;                                   -- bitstream of the line
    target_i : in    std_logic_vector(COUNTER_BITS - 1 downto 0); -- count at which the machine stops
    count_o  : out   std_logic_vector(COUNTER_BITS - 1 downto 0); -- number of ones
    full_o   : out   std_logic                                    -- the count is equal to the target
  );
end entity bm1_counter;

architecture rtl of bm1_counter is

  signal count : unsigned(COUNTER_BITS - 1 downto 0) := (others => '0');

begin

  integrate : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (clear_i = '1') then
        count <= (others => '0');
      elsif (enable_i = '1' and bit_i = '1') then
        count <= count + 1;
      end if;
    end if;

  end process integrate;

  count_o <= std_logic_vector(count);

  full_o <= '1' when count = unsigned(target_i) else
            '0';

end architecture rtl;
