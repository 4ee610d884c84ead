-- ================================================================================================
-- rosbayes: bm1_table_player
-- Random number generator: repeats a table of recorded random numbers.
-- MIT licence; datasheet: docs/hardware/bm1_table_player.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

library work;
  use work.bm1_utilities.all;

entity bm1_table_player is
  generic (
    STATE_BITS : positive; -- width of the index in the table
    PROB_BITS  : positive; -- width of a random number
    TABLE_FILE : string;   -- MIF of the random numbers
    LENGTH     : positive; -- number of entries in the table
    STEPS      : positive  -- number of entries by which the index advances per clock
  );
  port (
    clk_i    : in    std_logic;                                 -- clock
    shift_i  : in    std_logic;                                 -- load seed_i into the index
    seed_i   : in    std_logic_vector(STATE_BITS - 1 downto 0); -- seed from the seed memory or the previous generator
    step_i   : in    std_logic;                                 -- advance the index by STEPS
    state_o  : out   std_logic_vector(STATE_BITS - 1 downto 0); -- index in the table
    random_o : out   std_logic_vector(PROB_BITS - 1 downto 0)   -- entry of the table at index state_o
  );
end entity bm1_table_player;

architecture rtl of bm1_table_player is

  constant STRIDE : natural := STEPS mod LENGTH;

  signal place     : unsigned(STATE_BITS - 1 downto 0) := (others => '0');
  signal following : unsigned(STATE_BITS - 1 downto 0);
  signal enable    : std_logic;

begin

  choose_next : process (all) is

    variable sum : unsigned(STATE_BITS downto 0);

  begin

    sum := resize(place, STATE_BITS + 1) + STRIDE;

    if (sum >= LENGTH) then
      sum := sum - LENGTH;
    end if;

    if (shift_i = '1') then
      following <= unsigned(seed_i);
    else
      following <= sum(STATE_BITS - 1 downto 0);
    end if;

  end process choose_next;

  enable <= shift_i or step_i;

  hold_place : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (enable = '1') then
        place <= following;
      end if;
    end if;

  end process hold_place;

  -- The memory is read at the next index, so its output always belongs to the current index.
  numbers : component bm1_table
    generic map (
      file_name    => TABLE_FILE,
      word_bits    => PROB_BITS,
      depth        => LENGTH,
      address_bits => STATE_BITS,
      first_bit    => 0,
      data_bits    => PROB_BITS
    )
    port map (
      clk_i     => clk_i,
      enable_i  => enable,
      address_i => std_logic_vector(following),
      data_o    => random_o
    );

  state_o <= std_logic_vector(place);

end architecture rtl;
